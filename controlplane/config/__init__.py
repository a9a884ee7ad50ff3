"""The control plane's configuration file and access policy."""
