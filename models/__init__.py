"""Programs that make the shipped checkpoints and the gel tower, and score them; not installed.

python -m models.shipped        make, calibrate and score the shipped checkpoints
python -m models.gel_tower      make the gel tower
python -m models.recognition    compare checkpoints among 10, 100 and 1,000 unseen objects
python -m models.conditions     compare recognition in photos by other cameras, on other grounds and with faults
python -m models.verdicts       score the verdicts "match", "none of these", "no contact" and "not a gel image"
"""
