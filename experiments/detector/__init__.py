"""How well are logs found? Average precision on pictures whose worlds and renderer were not trained on."""
