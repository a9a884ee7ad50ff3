"""A robot and a cloud of the fleet that were taken over attack it in every way they can, all at once, for minutes.

Two honest robots and two honest clouds go on beside them (`stage`), undisturbed at first, then attacked, then left
alone again, all the while the same processes (`command`). `report` judges by limits that stand there.
"""
