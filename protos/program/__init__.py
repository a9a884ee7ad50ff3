"""Provides what every program needs: command line, configuration, log, certificates, metrics. No other IO in protos."""
