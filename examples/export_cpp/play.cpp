// A policy that `ringfence export` wrote, played by ONNX Runtime: memory is fed back, noise is drawn, actions printed.
//
//     play policy.onnx [steps]        reads observations (and the state, where the file asks for it) from stdin
#include <onnxruntime_cxx_api.h>

#include <cmath>
#include <cstdlib>
#include <iostream>
#include <map>
#include <random>
#include <sstream>
#include <string>
#include <type_traits>
#include <vector>

using Shape = std::vector<int64_t>;

int main(int argc, char** argv) {
  if (argc < 2) return std::cerr << "play policy.onnx [steps]\n", 2;
  const int steps = argc > 2 ? std::atoi(argv[2]) : 1;
  Ort::Env env(ORT_LOGGING_LEVEL_ERROR, "ringfence");
  Ort::Session session(env, argv[1], Ort::SessionOptions{});
  Ort::AllocatorWithDefaultOptions heap;
  const auto facts = session.GetModelMetadata();
  const auto told = [&](const std::string& key) {
    const auto value = facts.LookupCustomMetadataMapAllocated(key.c_str(), heap);
    return std::string(value ? value.get() : "");
  };
  std::cerr << told("ringfence") << '\n';  // JSON: task, guard, names of agents and entries, bounds of actions

  const auto cpu = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
  std::vector<std::string> ins, outs;
  std::map<std::string, std::vector<float>> numbers;  // inputs of floats, by name
  std::map<std::string, std::vector<int32_t>> counts;  // and of whole numbers
  std::map<std::string, Shape> shapes;
  for (size_t i = 0; i < session.GetInputCount(); ++i) {
    const std::string name = session.GetInputNameAllocated(i, heap).get();
    const auto info = session.GetInputTypeInfo(i);
    const auto tensor = info.GetTensorTypeAndShapeInfo();
    std::vector<float> values(tensor.GetElementCount(), name == "cost" ? NAN : 0.0f);  // NaN: nobody told a cost
    std::istringstream initial(told("initial." + name));  // one number for all entries, or every one of them
    std::vector<float> given;
    for (std::string word; initial >> word;) given.push_back(std::strtof(word.c_str(), nullptr));  // streams read no NaN
    for (size_t k = 0; k < values.size() && !given.empty(); ++k) values[k] = given[given.size() > 1 ? k : 0];
    ins.push_back(name), shapes[name] = tensor.GetShape();
    const bool whole = tensor.GetElementType() == ONNX_TENSOR_ELEMENT_DATA_TYPE_INT32;
    if (whole) counts[name].assign(values.begin(), values.end());
    else numbers[name] = values;
  }
  for (size_t i = 0; i < session.GetOutputCount(); ++i) outs.push_back(session.GetOutputNameAllocated(i, heap).get());

  std::mt19937 random(0);
  std::normal_distribution<float> normal;
  std::vector<const char*> in, out;
  for (const auto& name : ins) in.push_back(name.c_str());
  for (const auto& name : outs) out.push_back(name.c_str());
  for (int t = 0; t < steps; ++t) {
    std::vector<Ort::Value> values;
    for (const auto& name : ins) {
      const Shape& shape = shapes[name];
      if (name == "observations" || name == "state") for (float& x : numbers[name]) std::cin >> x;
      if (name.rfind("noise.", 0) == 0) for (float& x : numbers[name]) x = normal(random);
      const auto wrap = [&](auto& x) {
        using Number = typename std::decay_t<decltype(x)>::value_type;
        values.push_back(Ort::Value::CreateTensor<Number>(cpu, x.data(), x.size(), shape.data(), shape.size()));
      };
      if (counts.count(name)) wrap(counts[name]);
      else wrap(numbers[name]);
    }
    const auto found = session.Run(Ort::RunOptions{}, in.data(), values.data(), in.size(), out.data(), out.size());
    for (size_t i = 0; i < outs.size(); ++i) {
      const size_t many = found[i].GetTensorTypeAndShapeInfo().GetElementCount();
      if (outs[i] == "action") {
        const float* x = found[i].GetTensorData<float>();
        for (size_t k = 0; k < many; ++k) std::cout << x[k] << (k + 1 < many ? ' ' : '\n');
      } else if (outs[i].rfind("next.", 0) == 0) {
        const std::string name = "memory." + outs[i].substr(5);
        const auto keep = [&](auto& x) {
          const auto* first = found[i].template GetTensorData<typename std::decay_t<decltype(x)>::value_type>();
          x.assign(first, first + many);
        };
        if (counts.count(name)) keep(counts[name]);
        else keep(numbers[name]);
      }
    }
  }
}
