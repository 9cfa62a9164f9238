"""Figures and the result page. Every name is imported when it is used."""
