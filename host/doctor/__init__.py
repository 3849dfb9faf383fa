"""Checks of the installation and of this computer's real-time readiness.

``installation.examine`` checks the installation; ``facts.read`` and ``timing.evaluate`` check the computer.  Facts are
read below a root directory (``/``, or a test tree); evaluating them is pure.  The result is a sequence of
`finding.Finding`: a sentence, and for a suggested change its gain and the exact command.
"""
