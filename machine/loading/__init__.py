"""Reads and checks profiles (TOML)."""
