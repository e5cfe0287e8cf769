"""The network that verifies the candidates of `corrmat register`: trained, put into the package.

It belongs to the matching weights that ship: after `make weights` it is trained anew.
"""

from corrmat.registration.verification_training import train_verification
from corrmat.scripts import call

if __name__ == "__main__":
    call(train_verification)
