"""A day in the life of a fleet, in simulated time: the control plane's core and a thousand sidecars' ends of it."""
