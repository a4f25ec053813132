"""What holds for every test: a property may take as long as a busy machine makes it take."""

from hypothesis import settings

settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")
