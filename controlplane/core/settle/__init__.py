"""Decides which parts of a new plan are worth a change, and what is worth exploring. Imports `problem`."""
