from ccdtools.controllers.controllers import PID as PID, LinearFeedback as LinearFeedback, Passive as Passive
from ccdtools.controllers.filtered import Filtered as Filtered
from ccdtools.controllers.history import History as History, load_policy as load_policy
from ccdtools.controllers.learned import LearnedPolicy as LearnedPolicy
from ccdtools.controllers.observed import Observed as Observed
from ccdtools.controllers.policy_onnx import OnnxPolicy as OnnxPolicy
from ccdtools.controllers.previewing import Previewing as Previewing
from ccdtools.controllers.signals import Reference as Reference
