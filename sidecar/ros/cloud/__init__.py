"""The cloud's end: local servers, what waits for them, and whether they live."""
