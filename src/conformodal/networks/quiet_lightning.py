"""Lightning, imported without a warning of the progress bars that are not drawn here.

In a notebook without widgets tqdm, which packages of Lightning import, warns of its own bars.
"""

import warnings

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", message="IProgress not found")
    import lightning
    from lightning.pytorch.callbacks import Callback

__all__ = ["Callback", "lightning"]
