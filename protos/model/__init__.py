"""Defines the vocabulary of both planes: frozen values and typed identifiers. Imports `base`."""
