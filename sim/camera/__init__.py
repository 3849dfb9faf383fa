"""The plant's eyes: an analytic RGB-D renderer, a stereo noise model, labels, and the cameras bolted to the machine.

``geometry`` pinholes and poses, ``scene`` what there is to see, ``clutter`` grass and branches, ``visibility`` and
``shading`` the two numba passes, ``render`` their door, ``noise`` what stereo makes of it, ``tiny`` an independent
second renderer, ``labels`` the truth for training and judging, ``rig`` the cameras of a machine.
"""
