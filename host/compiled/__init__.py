"""Compiles the controller's tick ahead of time with mypyc; `runtime.compiled` finds and loads the result."""
