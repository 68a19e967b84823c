from .genotype import Genotype as Genotype
from .genotype import Space as Space
from .genotype import make_genotype as make_genotype
from .genotype import make_space as make_space
from .growth import Growth as Growth
from .kinds import find_genotype as find_genotype
from .table import GENOTYPES as GENOTYPES
