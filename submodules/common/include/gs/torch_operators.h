#pragma once
// Registration of operators through torch's stable interface. For csrc/torch alone.
#include <torch/csrc/stable/library.h>

#include <string>

namespace gs {

// Some operators of a namespace. Made by GS_OPERATORS, they stay until the program ends.
class Operators {
 public:
  using Boxed = void (*)(StableIValue*, uint64_t, uint64_t);  // of TORCH_BOX

  Operators(const char* name, void (*fill)(Operators&), const char* file, uint32_t line)
      : schemas_(Library::Kind::FRAGMENT, name, nullptr, file, line),
        cpu_(Library::Kind::IMPL, name, "CPU", file, line),
        cuda_(Library::Kind::IMPL, name, "CUDA", file, line) {
    fill(*this);
  }

  // Defines an operator by its schema and registers its function, for the CPU and in a build with CUDA for GPUs too.
  void define(const std::string& schema, Boxed function) {
    schemas_.def(schema.c_str());
    const std::string name = schema.substr(0, schema.find('('));
    cpu_.impl(name.c_str(), function);
#ifdef GS_CUDA
    cuda_.impl(name.c_str(), function);
#endif
  }

  // The same with one function for all devices, for calls without a tensor too.
  void define_for_all(const std::string& schema, Boxed function) {
    schemas_.def(schema.c_str());
    schemas_.impl(schema.substr(0, schema.find('(')).c_str(), function);
  }

 private:
  using Library = torch::stable::detail::StableLibrary;
  Library schemas_, cpu_, cuda_;
};

}  // namespace gs

// GS_OPERATORS(namespace, m) { m.define(...); }, once in a file.
#define GS_OPERATORS(name, m)                                                                     \
  static void define_operators(::gs::Operators&);                                                 \
  static const ::gs::Operators operators(#name, &define_operators, __FILE__, uint32_t(__LINE__)); \
  static void define_operators(::gs::Operators& m)
