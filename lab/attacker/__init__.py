"""Plays an attacker on the network, for tests and measurements inside the lab: listens, changes, repeats, floods."""
