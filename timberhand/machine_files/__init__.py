"""The files of a machine of one's own, in one folder: drafted from answers, and checked against each other."""
