"""The alerts of deploy/prometheus in a real Prometheus and Alertmanager, beside a real control plane."""
