"""What if: a prediction under another route, speed, start, wind or other parameters; neither aircraft nor twin change.

payload --question--> `WhatIf`; copy of the twin --elsewhere, instead--> another start, another course --answer--> path
"""
