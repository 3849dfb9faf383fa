"""The contract with a machine PLC on Ethernet: register map, cyclic datagram, and the one module that speaks Modbus."""
