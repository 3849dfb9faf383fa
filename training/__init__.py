"""Worlds to learn from: piles settled once by physics, seen many times by the analytic renderer.

``piles`` settles and keeps them, ``frames`` draws pictures with their truth, ``samples`` keeps and serves those.
"""
