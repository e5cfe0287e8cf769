"""The network that verifies the candidates of `corrmat register`: trained, put into the package.

It belongs to the matching weights that ship: after `make weights` it is trained anew.
"""

from jsonargparse import auto_cli

from corrmat.registration.verification_training import train_verification
from corrmat.training.console import print_messages

if __name__ == "__main__":
    print_messages(0)
    auto_cli(train_verification)
