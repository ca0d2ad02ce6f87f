"""How long a question for every aircraft's prediction takes?"""
