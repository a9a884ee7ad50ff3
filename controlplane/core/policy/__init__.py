"""Applies access policy and path rules: who may call, offer and use what. Imports `registry`."""
