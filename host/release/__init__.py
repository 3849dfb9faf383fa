"""Releases of the program on a target computer: bundles, their signature, the two trees, and the update.

A *bundle* brings everything of a release without a network (`bundle`): wheels, their hashes for pip, and
``SHA256SUMS`` with an Ed25519 signature (`sums`, `signature`), which Debian's ``openssl`` and ``sha256sum`` check as
well.  An installed release is a tree of its own below ``/opt/timberhand/releases`` (`trees`); the link ``current``
names the one in use.  `steps` is the update as data and pure decisions, `gate` what the new release must show before it
stays, `updater` what carries the steps out, `services` their hands on systemd.  `installed` compares the tree in use
with its signed list.
"""
