"""The hard-timed controller process: 200 Hz, one thread, pure `step`, thin `loop`."""
