"""The emulated CAN nodes of both buses: pure state machines on virtual time, frames in and frames out.

Every node has ``receive(key, data, now_ns)``; its frames go to the ``Outbox`` of its bus, a list of (key, data).
"""

Outbox = list[tuple[int, bytes]]
