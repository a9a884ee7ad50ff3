"""The control plane's configuration file, and its access policy."""
