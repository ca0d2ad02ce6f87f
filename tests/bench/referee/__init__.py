"""Do workers that share a fleet replace each other before anyone notices?"""
