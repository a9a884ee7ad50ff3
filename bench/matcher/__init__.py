"""The matcher's predictions and choices against recorded networks, offline: no lab, no clock."""
