"""The bridge to a PLC: emulates the machine's nodes on crane0 and passes supervised commands on."""
