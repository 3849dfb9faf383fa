"""The timing experiment: the real controller process against the host it runs on."""
