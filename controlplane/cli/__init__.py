"""`plr`: the operator's commands."""
