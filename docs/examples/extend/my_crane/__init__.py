"""What a package of your own may add to timberhand: one module for each kind."""
