"""The contract of both planes, and what every program starts with."""
