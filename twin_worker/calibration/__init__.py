"""How far predictions may be trusted: misses, calibration tables, tubes and horizons that adapt to each aircraft.

`pretend.json` comes from simulated flights of 600 s (`fleet fly --uavs 0-2 --for 600`), scored by `fleet assess`:

    known, absent (`--without-params`)   seeds 811..816, wind 0.5 2 3 4 5 6 m/s, turbulence 1 1 2 2 2 3
    px4 (`--autopilot px4`)              seeds 821..824, wind 1 3 4 6 m/s, turbulence 1 2 2 2
    c172p (`--aircraft c172p`)           seeds 831..834, likewise
"""
