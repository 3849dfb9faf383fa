"""Drafts the files of a machine of one's own from the answers of a questionnaire."""
