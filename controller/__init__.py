"""The hard-timed controller process: a pure `controller.step.step` at 200 Hz inside a thin loop (`process`)."""
