"""The data plane without IO: takes the time, bytes and events; gives datagrams and events."""
