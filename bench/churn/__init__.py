"""Disturbs the whole system for minutes, and counts requests lost or answered twice, and growth in memory and threads.

The troubles are drawn beforehand from a seed (`schedule`). `runner` has `hands` inflict each on the lab only once the
remaining resources are seen to work, while `samples` watches the processes. `report` judges.
"""
