"""Implements the STUN client (RFC 8489). Stands by itself."""
