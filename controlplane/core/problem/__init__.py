"""Defines the assignment problem: blocks, choices, costs, plans (paper, section on the matcher). Imports `estimate`."""
