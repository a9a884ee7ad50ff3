"""The robot's role: requests from the application to the first answer.

Imports `base`, `wire`, `message`, `seam`, `rules` and `transfer`; `request_table` stands above `dispatch`, that above
`measure`, that above `request` and `fallback`.
"""
