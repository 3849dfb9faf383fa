"""The timing experiment and the soak test: the real controller process on the host it runs on."""
