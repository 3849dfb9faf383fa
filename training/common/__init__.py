"""What every training uses: the loop, model cards, average precision, errors of data sets."""
