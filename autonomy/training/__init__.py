"""Training: data sets, labels, the loop and the model cards.  Needs torch; nothing here runs on the machine."""
