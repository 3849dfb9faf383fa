"""The calibration experiment: does ``timberhand calibrate`` recover the hidden truth?"""
