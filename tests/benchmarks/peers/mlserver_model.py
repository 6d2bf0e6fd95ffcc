"""MLServer's side of `make bench-serving`: the ONNX file behind its gRPC server, one session, one thread."""

import onnxruntime as ort
from mlserver import MLModel
from mlserver.codecs import NumpyCodec
from mlserver.types import InferenceRequest, InferenceResponse


class OnnxModel(MLModel):
    async def load(self) -> bool:
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = ort.InferenceSession(self.settings.parameters.uri, options, providers=["CPUExecutionProvider"])
        self.names = [output.name for output in self.session.get_outputs()]
        return True

    async def predict(self, payload: InferenceRequest) -> InferenceResponse:
        inputs = {entry.name: NumpyCodec.decode_input(entry) for entry in payload.inputs}
        values = self.session.run(self.names, inputs)
        outputs = [NumpyCodec.encode_output(name, value) for name, value in zip(self.names, values, strict=True)]
        return InferenceResponse(model_name=self.name, outputs=outputs)
