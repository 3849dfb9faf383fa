"""The ground truth about one individual machine, hidden from everything outside ``sim``."""
