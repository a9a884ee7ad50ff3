"""Tests the alerts of deploy/prometheus in a real Prometheus and Alertmanager, with a real control plane."""
