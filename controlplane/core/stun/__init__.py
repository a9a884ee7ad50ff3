"""Answers STUN Binding requests. Stands by itself."""
