"""From an assignment problem to a plan within a time limit: decomposition, then CP-SAT."""
