"""Parts that every experiment shares: job pool, checkpoint, result, plots, result page, worlds and machines."""
