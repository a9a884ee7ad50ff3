"""Shows the product survive a link, a server and the control plane."""
