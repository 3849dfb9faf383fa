"""The bridge to a machine PLC on Ethernet: it plays the machine's nodes on crane0, as if they were there."""
