"""How many aircraft a machine holds, and what gives way first?"""
