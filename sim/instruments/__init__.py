"""Instruments that read the plant's ground truth: an ideal log detector and a total station."""
