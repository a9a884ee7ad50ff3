"""What each sidecar is told, and whether it took it. Imports `registry`, `policy`, `problem` and `formulation`."""
