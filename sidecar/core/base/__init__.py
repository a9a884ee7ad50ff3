"""The bottom: identities and reasons that every part speaks, timers, fair shares. Imports nothing of the core."""
