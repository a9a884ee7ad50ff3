"""What of a new plan is worth a change, and what is worth exploring. Imports `problem`."""
