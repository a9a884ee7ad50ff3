"""Minutes of trouble for the whole system, and what it cost: requests lost, answered twice, memory and threads grown.

The troubles are drawn beforehand from a seed (`schedule`), done to the lab by `hands`, each only once the resources
that stay are seen to work (`runner`), while `samples` watches the processes. `report` judges.
"""
