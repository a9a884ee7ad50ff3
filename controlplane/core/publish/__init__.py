"""Tells each sidecar what to hold, and tracks whether it took it. Imports `registry`, `policy`, `problem`,
`formulation`."""
