"""DBC files: from signals to compiled codecs, and the check of a file."""
