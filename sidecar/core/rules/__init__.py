"""What the configuration says of services and of what copies may cost. Imports `base` and `message`."""
