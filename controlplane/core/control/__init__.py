"""Runs the control plane without IO: messages and time in, messages and notices out. Imports everything but `stun`."""
