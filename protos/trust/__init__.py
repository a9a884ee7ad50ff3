"""Establishes who a node is and what it signed: certificates, credentials, tokens. Imports `base` and `model`."""
