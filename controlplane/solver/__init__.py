"""Solves an assignment problem within a time limit: decomposition, then CP-SAT."""
