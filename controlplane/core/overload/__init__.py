"""Keeps the control plane alive when much is asked of it: admission, pacing, shares. Imports `base`."""
