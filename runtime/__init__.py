"""What every process needs and no floor owns: errors with codes, and how the allocator behaves."""
