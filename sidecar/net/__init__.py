"""Moves the datagrams: sockets, one thread for each interface, and the interfaces as they come and go."""
