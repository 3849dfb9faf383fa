"""What any floor may use: errors with codes, the behaviour of the allocator, the style of plots."""
