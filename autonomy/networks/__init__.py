"""Networks as data: one description, run by torch where it is trained and by OpenVINO where it works."""
