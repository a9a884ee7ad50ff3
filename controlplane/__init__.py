"""The control plane: discovery, STUN, estimates, the assignment problem, and its push to the sidecars."""
