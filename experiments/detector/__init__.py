"""The detector experiment: average precision on pictures whose worlds and renderer were not used for training."""
