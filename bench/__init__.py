"""Measures: the data plane, the control plane, the matcher, whole drives."""
