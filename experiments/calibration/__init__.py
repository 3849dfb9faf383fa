"""Does ``timberhand calibrate`` recover what the plant hides?"""
