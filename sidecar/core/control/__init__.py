"""The sidecar's end of the control stream, and over which way it is reached. Imports `base`."""
