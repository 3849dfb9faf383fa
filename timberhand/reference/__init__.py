"""The reference pages that are generated from the code: ``python -m timberhand.reference``."""
