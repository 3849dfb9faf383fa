"""The emulated CAN nodes of crane0: pure state machines on virtual time, frames in and frames out.

Every node has ``receive(key, data, now_ns)``; what it sends goes to ``Outbox``, a list of (key, data).
"""

Outbox = list[tuple[int, bytes]]
