"""Lets a compromised robot and a compromised cloud attack the fleet in every way they can, all at once, for minutes.

Two honest robots and two honest clouds keep working beside them (`stage`): undisturbed at first, then attacked, then
left alone again, with the same processes throughout (`command`). `report` judges by the limits defined there.
"""
