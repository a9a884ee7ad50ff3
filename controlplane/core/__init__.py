"""The control plane without IO: takes the time and messages; gives messages and notices."""
