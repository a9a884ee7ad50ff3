"""One message in symbols: sent, put together, repaired. Imports `base` and `wire`."""
