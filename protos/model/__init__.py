"""The words both planes speak: frozen values and typed identifiers. Imports `base`."""
