"""Tests the matcher's predictions and choices against recorded networks, offline: without a lab or a clock."""
