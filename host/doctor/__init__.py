"""What a technician asks first: is this installation sane, and is this computer ready for a hard-timed loop?

``installation.examine`` answers the first, ``facts.read`` and ``timing.judge`` the second.  Reading and judging are
apart: facts come from a root directory (``/``, or a made-up tree), and judging them is pure.  Whatever is found is a
`finding.Finding`: a sentence, and where something should change, what is gained and the exact command.
"""
