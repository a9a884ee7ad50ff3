"""The STUN client (RFC 8489). Stands by itself."""
