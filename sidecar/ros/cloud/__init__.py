"""Runs the cloud's end: local servers, the requests that wait for them, and whether the servers live."""
