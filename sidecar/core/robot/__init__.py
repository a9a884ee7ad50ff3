"""Plays the robot's role: takes each request from the application to its first answer.

Imports `base`, `wire`, `message`, `seam`, `rules` and `transfer`. `robot_role`, which the engine calls, stands above
`request_table`, which stands above `dispatch`, which stands above `measure`, which stands above `request` and
`fallback`.
"""
