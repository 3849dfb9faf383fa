"""The parts experiment: movement primitives, swing arms and float valves, levelling, and pictures while driving."""
