"""Provides the STUN codec (RFC 8489) for both planes. Imports `base`."""
