"""How the control plane stays alive when much is asked of it: admission, pacing, shares. Imports `base`."""
