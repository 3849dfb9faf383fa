"""The whole forwarding task: paper B's trial on its field, both ways, and many more with ours."""
