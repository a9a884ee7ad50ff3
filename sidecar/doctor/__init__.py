"""Examines a node without the control plane: plr doctor, plr ping, plr bugreport."""
