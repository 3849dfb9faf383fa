"""The planning process: command line, sockets, jobs, operator commands and the published mission report."""
