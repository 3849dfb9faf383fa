"""Whole live runs on SocketCAN, seed by seed: are they quiet, in which time, and what did the host take?"""
