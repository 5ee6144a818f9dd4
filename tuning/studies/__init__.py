"""The computations of the commands: each study returns its results and writes a result folder.

Read `tuner.tune` first, then `campaign_folder.simulate` for Monte Carlo campaigns.
"""
