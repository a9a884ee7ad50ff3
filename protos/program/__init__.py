"""What every program starts with: command line, configuration, log, certificate files, metrics. The only IO here."""
