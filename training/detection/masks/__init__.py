"""Training of the mask network on whatever device torch finds; pictures and their changes live on that device."""
