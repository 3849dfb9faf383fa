"""Requests that arrive as datagrams: their checks, their order and the memory of refusals."""
